"""Schedulers, one a file, and what they are allowed to do."""
