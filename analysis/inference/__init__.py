"""Noise, block means, and the linear-Gaussian fit that identification and gap share."""
