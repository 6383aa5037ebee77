"""Training of static scenes from posed pictures, as in 3DGS (Kerbl et al. 2023)."""
