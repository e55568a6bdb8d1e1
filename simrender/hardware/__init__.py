"""Simulated time, no rays: SimPy models of networks, processors, storage, displays and machines."""
