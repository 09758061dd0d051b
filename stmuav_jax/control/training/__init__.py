"""Training of policies: episodes on a sampled plant as pure functions, and Gymnasium's classes."""
