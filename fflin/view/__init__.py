"""Views of robots, motions and modes in meshcat: an HTML page, pictures, or a live page.

The JavaScript of the pages is in `view/assets`.

Imports `base`, `robot`, `dynamics`, `linear`, `analysis` and `simulation`.
"""
