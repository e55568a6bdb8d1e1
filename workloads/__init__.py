"""Workload cards."""
