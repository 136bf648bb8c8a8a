"""One fit of a nominal model to all runs of a specimen."""
