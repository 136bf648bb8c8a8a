"""The command line: thin commands over what `import dragrig` gives."""
