"""Health checks of a run: findings read off its metrics."""
