"""Environments that are known to a box: a promise for all of them, proved at the vertices and searched between."""
