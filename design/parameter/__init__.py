"""The convex problem in the parameter Q of an optimal coupling. design.optimal is its front."""
