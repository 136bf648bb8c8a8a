"""Foreign measurements in, run files out; the public names are those of `dragrig.analysis`."""
