"""Pre-Grasp informed Dexterous Manipulation."""
