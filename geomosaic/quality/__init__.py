"""Displacement vectors, SSIM, jumps between patches, misalignment: judged apart from the pipeline."""
