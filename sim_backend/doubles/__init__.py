"""Doubles of card and drive that the real client libraries talk to: for tests and demonstrations, never a fallback."""
