"""SpRay's smaller isosurface of the channel flow, from the back; see `workloads.dns`."""
