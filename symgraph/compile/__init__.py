"""From CasADi functions to machine code: the C compiler, the cache of what it made, and kernels over many points."""
