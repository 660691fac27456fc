"""PartNet-Mobility, the files ``mobility_v2.json`` of articulated objects with their meshes."""
