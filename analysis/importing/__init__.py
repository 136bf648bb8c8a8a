"""Foreign measurements in, run files out."""
