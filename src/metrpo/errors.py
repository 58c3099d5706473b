"""The errors that a user can cause; each message says what was expected, what was got and what to do."""


class MetrpoError(Exception):
    """Base of every error that metrpo raises on purpose; the command line prints its message and exits with 2."""


class ConfigError(MetrpoError):
    """A setting is unknown, of the wrong type or impossible."""


class TaskError(MetrpoError):
    """A task is unknown, or its environment broke its promise."""


class DivergedError(MetrpoError):
    """Learning has left the finite numbers for good; nothing of its iteration has been saved."""


class RunDirectoryError(MetrpoError):
    """A run directory is in use, of another version, damaged, not writable, or holds another run."""
