"""MCP server over all robots of a network: ``strands-robots mcp``."""
