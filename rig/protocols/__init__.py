"""One file per kind of run: a validated description that yields its motion."""
