"""The one error of everything that reads scenes."""


class SceneError(ValueError):
    """A scene that cannot be used as it is.

    The message names the file, what was expected there, what came, and what to do.
    """
