"""Machines, one folder each with a card.yaml; found through the entry-point group ``simrender.machines``."""
