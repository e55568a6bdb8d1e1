"""Simulated time, no rays: SimPy models of networks, processors and machines."""

from simrender.hardware.network import Link, Network

__all__ = ["Link", "Network"]
