"""The one exception that means: the input is wrong, and here is how to mend it."""


class InputError(ValueError):
    """Bad input from a user: a file, a setting or an image.

    The message is one line that says where, what was found, what was expected and what to do. The command line prints
    it without a traceback and ends with exit status 2.
    """
