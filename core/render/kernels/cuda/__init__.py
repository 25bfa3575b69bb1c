"""NVIDIA Warp kernels on a CUDA card: a thread projects a splat in float64, a block of threads draws a tile in float32.

Tensors stay where they are: on a card the kernels run there, on the processor they run, slowly, through Warp's own
CPU back end, which is how they are tested without a card. Warp compiles a kernel when it is first launched and keeps
it on disk from then on.
"""
