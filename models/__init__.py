"""The paper's tasks as graphs."""
