"""The paper's rig: a preset made of the same parts as any other."""
