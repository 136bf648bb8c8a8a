"""What is made of run files: filters, exports, imports and measures."""
