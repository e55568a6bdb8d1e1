"""What a person sees: the answer on a terminal, plots, and traces for Perfetto."""
