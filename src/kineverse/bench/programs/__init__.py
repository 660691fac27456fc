"""What is run in fresh processes, where nothing else is loaded. Started as files, not imported."""
