"""A drive whose samples and parameters are OPC UA nodes, in the role supervise; needs the extra `opcua`."""
