"""What goes through the card: samples, digital lines, voltages."""
