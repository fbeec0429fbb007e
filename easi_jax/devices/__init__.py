"""How programs run: the runtime made ready, the mesh of devices, several processes."""
