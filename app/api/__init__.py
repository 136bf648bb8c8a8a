"""What `import dragrig` offers, by topic: each function here is a command of the command line too."""
