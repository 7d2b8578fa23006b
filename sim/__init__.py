"""Simulated operating room: patient, device, X-ray physics, acquisition. Everything it makes is synthetic."""
