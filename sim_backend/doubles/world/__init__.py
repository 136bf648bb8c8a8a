"""The bench itself: carriage, gut, sensor, encoder and wires, their time, and what befalls them."""
