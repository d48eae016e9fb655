"""A simulated arm joins the mesh, reports who is there, leaves and comes back."""

from strands_robots import Robot

arm = Robot("so100", mesh=True, peer_id="arm-1")
mesh = arm.mesh
print(f"{mesh.peer_id} alive: {mesh.alive}, sees {[peer['peer_id'] for peer in mesh.peers]}")
mesh.stop()
mesh.start()
print(f"back: {mesh.alive}, {mesh.get_peer('nobody')}, {mesh.peers_by_id}")
mesh.stop()
