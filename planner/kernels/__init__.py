"""The compiled core. Nothing here knows about files, costs' names or MuJoCo.

Kernels take float64 and int64 arrays in C order and scalars; callers validate and cast (a list or a float32
array would silently compile everything again).
"""
