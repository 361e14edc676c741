"""C code of control laws for flight software, and simulation with this code in the loop."""
