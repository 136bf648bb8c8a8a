"""The DAQ card: connection, tasks, sampler, and scaling of volts and counts."""
