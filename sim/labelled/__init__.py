"""Labelled views of patients: to train the landmark network, to measure it, and as a data set for others."""
