"""The paper's network with samples placed by a voxel grid."""
