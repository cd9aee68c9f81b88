"""What numba compiles, on arrays alone. Importing a module of it needs numba."""
