"""Pictures of run files and of the friction model, drawn with matplotlib."""
