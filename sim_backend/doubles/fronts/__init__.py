"""Where NI's own clients find the card's double: the C library and the gRPC service."""
