"""The tests of this project: a package, so that no other folder of this name is taken for it."""
