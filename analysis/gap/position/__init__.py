"""The position channel on its own: where the stage is against where it was told to be, and what explains it."""
