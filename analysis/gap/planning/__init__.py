"""Which run to make next: the one that best separates what a diagnosis could not, per minute of rig time."""
