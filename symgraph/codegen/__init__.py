"""The whole planner as C: a header, a source, and what builds and explains them."""
