"""The errors that a user can cause; each message says what was expected, what was got and what to do."""


class MetrpoError(Exception):
    """Base of every error that metrpo raises on purpose; the command line prints its message and exits with 2."""


class ConfigError(MetrpoError):
    """A setting is unknown, of the wrong type or impossible."""


class TaskError(MetrpoError):
    """A task is unknown, or its environment does not keep Gymnasium's rules."""


class MissingTaskError(TaskError):
    """The file or module in a task's name does not exist."""


class EpisodeError(TaskError):
    """An environment failed in an episode; another try may succeed."""


class NotFiniteError(EpisodeError):
    """An environment gave NaN or infinity in an episode, and would again with the same seed."""


class UnplayableError(TaskError):
    """Too many episodes of an environment have failed to try again."""


class DivergedError(MetrpoError):
    """Training diverged and cannot recover; nothing of the iteration was saved."""


class RunDirectoryError(MetrpoError):
    """A run directory is in use, of another version, damaged, not writable, or holds another run."""
