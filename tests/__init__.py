"""The tests of this project. They are a package so that `import tests` finds no other folder of this name."""
