"""Exit statuses of `femoreg`."""

DONE, AMISS, BAD_INPUT, NOT_TRUSTED, INTERRUPTED = 0, 1, 2, 3, 130
