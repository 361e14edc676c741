"""Views of robots, motions and modes in meshcat, as an HTML file, pictures, or a live page.

The JavaScript of the pages is in `view/assets`.

Imports `base`, `robot`, `dynamics`, `linear`, `analysis` and `simulation`.
"""
