"""How drives are spoken to: one module a dialect."""
