"""Valid and invalid inputs by grammar, a module for each format."""
