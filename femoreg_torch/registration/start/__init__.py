"""Start poses: by the landmark network, by landmarks that a person picked, or from another view."""
