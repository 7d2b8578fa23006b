"""X-ray physics: materials, spectrum, beam, line integrals, detector, and the raw image that comes of them."""
