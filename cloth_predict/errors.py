"""Errors that a user can mend: one line that names the file, line, label or parameter."""

from __future__ import annotations


class ClothPredictError(ValueError):
    """Base of all known errors; the command line prints it as one line and exits with 1."""

    def __init__(self, message: str) -> None:
        super().__init__(' '.join(message.splitlines()))


class ClothPredictWarning(UserWarning):
    """Something that a user should know of and that stops nothing."""


class ConfigError(ClothPredictError):
    """A configuration that cannot be used: names the file and the parameter."""


class FormatError(ClothPredictError):
    """A recording that cannot be used: names the file, and the line, topic or label."""


class FrameError(ClothPredictError):
    """One frame of markers that cannot be used; the next one may be good."""


class UncertainError(FrameError):
    """A prediction that would say nothing, as after too few markers for too long."""
