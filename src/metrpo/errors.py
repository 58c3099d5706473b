"""The errors that a user can cause; each message says what was expected, what was got and what to do."""


class MetrpoError(Exception):
    """Base of every error that metrpo raises on purpose; the command line prints its message and exits with 2."""


class ConfigError(MetrpoError):
    """A setting is unknown, of the wrong type or impossible."""


class TaskError(MetrpoError):
    """A task is unknown, or its environment broke its promise."""


class MissingTaskError(TaskError):
    """The file or module that a task's name says is not there."""


class EpisodeError(TaskError):
    """An environment has failed in an episode, which may go better the next time."""


class NotFiniteError(EpisodeError):
    """An environment gave NaN or infinity in an episode, and would again with the same seed."""


class UnplayableError(TaskError):
    """So many episodes of an environment have failed that trying more is of no use."""


class DivergedError(MetrpoError):
    """Learning has left the finite numbers for good; nothing of its iteration has been saved."""


class RunDirectoryError(MetrpoError):
    """A run directory is in use, of another version, damaged, not writable, or holds another run."""
