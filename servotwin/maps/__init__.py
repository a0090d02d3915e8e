"""`servotwin map`: stability maps computed in pieces, here or on a cluster, resumed, told and drawn."""
