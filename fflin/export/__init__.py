"""C code of control laws for flight software, and its simulation in the loop."""
