"""Studies of Kineverse: benchmarks with peers, and the experiments of the papers."""
