"""The larger isosurface of the Richtmyer-Meshkov instability; see `workloads.rm`."""
