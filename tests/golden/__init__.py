"""The golden record: figures of fflin on the bundled robots, which a change must leave as they are.

``python -m tests.golden --check`` compares both engines with it, ``--write`` makes it anew.
"""
