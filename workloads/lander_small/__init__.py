"""The small version of the Mars lander, 72 parts; see `workloads.lander`."""
