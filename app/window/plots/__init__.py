"""Plots whose cost does not grow with the length of what they show."""
