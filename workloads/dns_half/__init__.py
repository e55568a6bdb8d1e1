"""The turbulent channel flow at half the resolution along each axis; see `workloads.dns`."""
