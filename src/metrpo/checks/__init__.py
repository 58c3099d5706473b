"""Whether a run is healthy: what is read off its metrics, and what there is to say about it."""
