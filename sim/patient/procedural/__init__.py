"""Patients drawn from a seed: bones as swept shapes whose landmarks follow from their geometry."""
