"""SpRay's smaller isosurface of the channel flow, from the side; see `workloads.dns`."""
