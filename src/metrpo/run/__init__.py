"""Everything that touches disk or screen: run directories, metrics, policies, curves, videos, progress."""
