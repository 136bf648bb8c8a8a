"""What may be set: the schema of rig, capsule, specimen, model and plan, and the files that ship."""
