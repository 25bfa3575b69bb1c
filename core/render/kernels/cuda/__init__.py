"""NVIDIA Warp kernels on a CUDA card: a thread projects a splat in float64, a block of threads draws a tile in float32.

They run where their tensors are (`core.render.card` brings those of the processor to a card): on the processor, slowly,
through Warp's own CPU back end, which is how they are tested without a card. Warp compiles a kernel when it is first
launched and keeps it on disk from then on.
"""
