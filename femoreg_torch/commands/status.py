"""Exit statuses of `femoreg`."""

DONE, BAD_INPUT, NOT_TRUSTED, INTERRUPTED = 0, 2, 3, 130
