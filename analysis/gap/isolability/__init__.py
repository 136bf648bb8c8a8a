"""Which effects runs can tell apart, and how small a one they would show."""
