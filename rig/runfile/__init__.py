"""The run file: one run, one HDF5 file."""
