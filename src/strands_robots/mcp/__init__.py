"""MCP server over all robots: ``strands-robots mcp``."""
