"""The real rig: PCI-6229, NLA-7SL stage and its drive, behind the device protocols of `dragrig.rig.devices`."""
