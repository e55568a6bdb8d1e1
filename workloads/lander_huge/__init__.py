"""The huge version of the Mars lander, 552 parts; see `workloads.lander`."""
