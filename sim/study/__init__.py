"""The study engine: simulated procedures of fixed seeds, registered, and their errors told beside the paper's."""
