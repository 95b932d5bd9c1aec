"""The error of log files."""


class LogError(OSError):
    """A log cannot be written or read. The text is one sentence that names the file and a remedy."""
