"""SpRay's larger isosurface of the channel flow; see `workloads.dns`."""
