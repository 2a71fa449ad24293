"""What happens over frequency: sweeps that know the poles, suprema, integrals."""
