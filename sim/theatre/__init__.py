"""The simulated operating theatre: patient, device and C-arm in place, everything moved at random, six images."""
