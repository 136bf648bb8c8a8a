"""The PCI-6229 and NI's driver as their clients know them."""
