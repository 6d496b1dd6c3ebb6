"""Users' torch modules as models: exported by torch, written anew as CasADi expressions of inputs and weights."""
