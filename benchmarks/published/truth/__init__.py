"""Ground truth of published data sets."""
