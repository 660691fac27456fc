"""What writers of formats share: motions recognised, limits sorted, what is refused collected."""
