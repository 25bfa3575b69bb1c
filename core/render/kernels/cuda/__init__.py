"""NVIDIA Warp kernels in float32: one block of threads a tile of pixels, on a CUDA card.

Tensors stay where they are: on a card the kernels run there, on the processor they run, slowly, through Warp's own
CPU back end, which is how they are tested without a card. Warp compiles a kernel when it is first launched and keeps
it on disk from then on.
"""
