"""The running loop in a window or as a film.

events (keys, scripts, the loops that they lead to) <- session (clock, forces, mouse) <- stage (shapes, arrows, words)
<- window (live) and film (pictures in a file). Only window needs a display.
"""
