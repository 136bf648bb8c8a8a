"""What may be set: the schema of rig, specimen, capsule, friction model and plan, and the files that ship."""
