"""Delays that vary: the condition under which no switching of them is dangerous, and its proof."""
