"""Many materials: a library file to one result each, on one machine or on a cluster, resumed where it was stopped."""
