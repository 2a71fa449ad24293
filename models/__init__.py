"""The continuous, physical world: devices and human hands as one MuJoCo scene. It contains no controller."""
