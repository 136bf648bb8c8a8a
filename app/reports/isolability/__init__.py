"""The page of what runs can tell apart."""
