"""Conditions proved in exact arithmetic from stored coefficients. design.certificate is their front."""
