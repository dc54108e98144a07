// A CANopen master on the npm package "canopen" (a stack of others), speaking python-can's udp_multicast on loopback.
// usage: node third_party_master.js GROUP PORT SYNCS PERIOD_MS NODE...
// It maps each drive's PDOs by SDO, starts the nodes, sends SYNC, enables the drives and moves them along a known sine;
// on its last line it prints, as JSON, the targets it sent and the position PDOs it received. SYNC waits for the answers to
// the one before, but not for so long that a drive would miss it; after a stall time goes on from there, without a burst.
const dgram = require('dgram'), { encode, decode } = require('@msgpack/msgpack');
const { Device, Eds } = require('canopen');
const [group, port, syncs, period] = [process.argv[2], +process.argv[3], +process.argv[4], +process.argv[5]];
const sdoTimeout = 5000, longestWait = period + 200; // ms; the package's own SDO timeout is 30 ms
const nodes = process.argv.slice(6).map(Number);
const device = new Device({ id: 127, eds: new Eds() });
const socket = dgram.createSocket({ type: 'udp4', reuseAddr: true });
const received = Object.fromEntries(nodes.map((n) => [n, []])), targets = Object.fromEntries(nodes.map((n) => [n, []]));
const status = {};

function send(id, data) {
  const frame = { timestamp: Date.now() / 1e3, arbitration_id: id, is_extended_id: false, is_remote_frame: false, is_error_frame: false,
    channel: null, dlc: data.length, data, is_fd: false, bitrate_switch: false, error_state_indicator: false };
  socket.send(Buffer.from(encode(frame)), port, group);
}
device.addListener('message', (m) => send(m.id, m.data));
socket.on('message', (buffer) => {
  const f = decode(buffer), data = Buffer.from(f.data), node = f.arbitration_id & 0x7f;
  if (nodes.includes(node) && (f.arbitration_id & 0x780) === 0x180) {
    status[node] = data.readUInt16LE(0);
    received[node].push(data.readInt32LE(2));
  }
  device.receive({ id: f.arbitration_id, data, len: f.dlc });
});

function write(node, index, subIndex, value, size) {
  const data = Buffer.alloc(size);
  data.writeUIntLE(value, 0, size);
  return device.sdo.download({ serverId: node, index, subIndex, data, timeout: sdoTimeout });
}
const sleep = (ms) => new Promise((resolve) => setTimeout(resolve, ms));
async function answered(count, until) {
  while (nodes.some((n) => received[n].length < count) && Date.now() < until) await sleep(1);
}
async function configure(node) {
  for (const [communication, mapping, cobId, objects] of [
    [0x1800, 0x1a00, 0x180 + node, [0x60410010, 0x60640020, 0x60740010]],
    [0x1400, 0x1600, 0x200 + node, [0x60400010, 0x607a0020]],
  ]) {
    await write(node, communication, 1, 0x80000000 + cobId, 4);
    await write(node, communication, 2, 1, 1);
    await write(node, mapping, 0, 0, 1);
    for (let k = 0; k < objects.length; k++) await write(node, mapping, k + 1, objects[k], 4);
    await write(node, mapping, 0, objects.length, 1);
    await write(node, communication, 1, cobId, 4);
  }
  await write(node, 0x6060, 0, 8, 1);
}
function controlword(word) {
  if ((word & 0x4f) === 0x08) return 0x80; // a drive that missed SYNC for long
  if ((word & 0x4f) === 0x40) return 0x06;
  if ((word & 0x6f) === 0x21) return 0x07;
  return 0x0f;
}
async function main() {
  for (const node of nodes) device.eds.addSdoClientParameter(node, 0x600 + node, 0x580 + node);
  device.start();
  for (const node of nodes) await configure(node);
  for (const node of nodes) device.nmt.startNode(node);
  await sleep(50);
  for (let k = 0, at = Date.now(); k < syncs; k++, at = Math.max(at + period, Date.now() - period / 4)) {
    send(0x80, Buffer.alloc(0));
    while (Date.now() < at + period) await sleep(1);
    await answered(k + 1, at + longestWait);
    for (const node of nodes) {
      const data = Buffer.alloc(6), target = k < 20 ? 0 : Math.round(50000 * (1 - Math.cos((k - 20) * 0.04)));
      data.writeUInt16LE(controlword(status[node] || 0x40), 0);
      data.writeInt32LE(target, 2);
      targets[node].push(target);
      send(0x200 + node, data);
    }
  }
  await answered(syncs, Date.now() + 10000);
  process.stdout.write(JSON.stringify({ targets, received }) + '\n', () => process.exit(0));
}
socket.bind(port, group, () => {
  socket.addMembership(group, '127.0.0.1');
  socket.setMulticastInterface('127.0.0.1');
  socket.setMulticastTTL(0);
  main().catch((error) => { console.error(String(error)); process.exit(1); });
});
