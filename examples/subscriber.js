#!/usr/bin/env node
// Print the markers that a gateway publishes on LCM.
//
//   node examples/subscriber.js [SOURCE [COUNT]]     for example: LAB 100
//
// Running needs Node.js 18 or newer and no other package: the program reads LCM's packets and the messages by the tables
// of docs/reference/messages.md. (A browser cannot receive LCM.) SOURCE is the name of the source in upper case. The
// program stops after COUNT frames. The environment variable LCM_DEFAULT_URL sets the LCM URL. With --vectors, the
// program decodes messages from standard input instead (lcm_types/vectors/README.md).
'use strict';

const dgram = require('node:dgram');
const readline = require('node:readline');

// The messages: each field's name and type, and for an array its length or the field that has its length, in this
// order, without padding. An int64 becomes a BigInt, because a Number has only 53 bits.

const PREFIX = [
  ['utime', 'int64'],
  ['capture_utime', 'int64'],
  ['sequence', 'int64'],
  ['session', 'int32'],
  ['parameters_version', 'int32'],
  ['frame_number', 'int32'],
  ['timestamp', 'int64'],
];
const MARKER = ['x', 'y', 'z', 'reliability'].map((name) => [name, 'float']);
const TOOL = ['q0', 'qx', 'qy', 'qz', 'x', 'y', 'z', 'error'].map((name) => [name, 'float']);
const FORCE = ['fx', 'fy', 'fz', 'mx', 'my', 'mz'].map((name) => [name, 'float']);
const EVENT = [
  ['id', 'int32'],
  ['timestamp', 'int64'],
  ['param1', 'int32'],
  ['param2', 'int32'],
  ['param3', 'int32'],
];
const POSE = [
  ['visible', 'boolean'],
  ['position_m', 'float', 3],
  ['orientation_xyzw', 'float', 4],
  ['error_m', 'float'],
];

/** A component: its items are behind their number. */
const component = (count, items, type) => [...PREFIX, [count, 'int32'], [items, type, count]];

const TYPES = {
  markers_t: { fingerprint: 0xe95d5a478ce229e4n, fields: component('num_markers', 'markers', MARKER) },
  tools_t: { fingerprint: 0xf922a353b61657b3n, fields: component('num_tools', 'tools', TOOL) },
  analog_t: { fingerprint: 0xcd43a9dd46669becn, fields: component('num_channels', 'voltages', 'float') },
  forces_t: { fingerprint: 0xdc94defbb591810cn, fields: component('num_plates', 'plates', FORCE) },
  events_t: { fingerprint: 0x06a109c2ae7bf07cn, fields: component('num_events', 'events', EVENT) },
  tool_pose_t: { fingerprint: 0xbf985441ca59ae7an, fields: [...PREFIX, ...POSE] },
};

/** Reads big-endian values from a Buffer, one behind the other. Throws a RangeError behind its end. */
class Reader {
  constructor(buffer) {
    this.buffer = buffer;
    this.offset = 0;
  }

  /** Read a value of a primitive type, or a struct if `type` is a list of fields. */
  value(type) {
    if (Array.isArray(type)) return this.struct(type);
    const start = this.offset;
    switch (type) {
      case 'boolean':
        this.offset += 1;
        return this.buffer.readUInt8(start) !== 0;
      case 'int32':
        this.offset += 4;
        return this.buffer.readInt32BE(start);
      case 'int64':
        this.offset += 8;
        return this.buffer.readBigInt64BE(start);
      case 'float':
        this.offset += 4;
        return this.buffer.readFloatBE(start);
    }
    throw new TypeError(`no type ${type}`);
  }

  struct(fields) {
    const values = {};
    for (const [name, type, length] of fields) {
      values[name] = length === undefined ? this.value(type) : this.array(type, values[length] ?? length);
    }
    return values;
  }

  array(type, length) {
    if (length < 0) throw new RangeError(`an array of ${length} items`);
    const items = [];
    for (let i = 0; i < length; i++) items.push(this.value(type)); // ends at the end of the buffer
    return items;
  }
}

/** Decode a message. Throws an Error for bytes that are not a message of this type. */
function decode(typeName, message) {
  if (!Object.hasOwn(TYPES, typeName)) throw new Error(`no type ${typeName}`);
  const { fingerprint, fields } = TYPES[typeName];
  if (message.length < 8 || message.readBigUInt64BE() !== fingerprint) {
    throw new Error(`this is not a ${typeName}: it has another fingerprint`);
  }
  const reader = new Reader(message.subarray(8));
  const values = reader.struct(fields);
  if (reader.offset !== reader.buffer.length) throw new Error(`this ${typeName} is too long`);
  return values;
}

// LCM's packets: a whole message, or a fragment of one.

const MAGIC_MESSAGE = 0x4c433032; // "LC02"
const MAGIC_FRAGMENT = 0x4c433033; // "LC03"
const MAX_MESSAGE_BYTES = 1 << 20;
const MAX_SENDERS = 8;

/** Joins the fragments of messages. Like LCM itself, it keeps one incomplete message for each sender. */
class Assembler {
  partial = new Map();

  /** Return [channel, message] if a packet completes a message, undefined otherwise. */
  add(sender, packet) {
    if (packet.length < 8) return undefined;
    const magic = packet.readUInt32BE(0);
    if (magic === MAGIC_MESSAGE) return cutChannel(packet.subarray(8));
    if (magic !== MAGIC_FRAGMENT || packet.length < 20) return undefined;
    const sequence = packet.readUInt32BE(4);
    const size = packet.readUInt32BE(8);
    const offset = packet.readUInt32BE(12);
    const number = packet.readUInt16BE(16);
    const count = packet.readUInt16BE(18);
    if (size > MAX_MESSAGE_BYTES) return undefined;

    let partial = this.partial.get(sender);
    if (partial?.sequence !== sequence || partial.data.length !== size || partial.count !== count) {
      this.partial.delete(sender);
      if (this.partial.size >= MAX_SENDERS) this.partial.delete(this.partial.keys().next().value); // the oldest
      partial = { sequence, count, channel: '', data: Buffer.alloc(size), received: new Set() };
      this.partial.set(sender, partial);
    }
    let data = packet.subarray(20);
    if (number === 0) [partial.channel, data] = cutChannel(data);
    if (number >= count || offset + data.length > size) return undefined;
    data.copy(partial.data, offset);
    partial.received.add(number);
    if (partial.received.size < count) return undefined;
    this.partial.delete(sender);
    return [partial.channel, partial.data];
  }
}

/** Split the name of the channel, which ends with a NUL, from the data behind it. */
function cutChannel(data) {
  const end = data.indexOf(0);
  return end < 0 ? ['', data] : [data.toString('utf8', 0, end), data.subarray(end + 1)];
}

// The subscriber.

/** Passes frames on in order. The gateway sends those again that are lost, as long as it has them. */
class GapFiller {
  newest = undefined; // the number of the newest frame that was passed on
  held = []; // frames that wait for the missing ones before them

  /** `ask` requests the frames from one number to another again, and `show` takes a frame. */
  constructor(ask, show) {
    Object.assign(this, { ask, show });
  }

  add(message) {
    this.held.push(message);
    if (this.held.length === 1) this.proceed();
  }

  addAgain(message) {
    if (this.held.length === 0 || message.sequence !== this.newest + 1n) return;
    this.pass(message);
    if (this.held[0]?.sequence <= this.newest + 1n) this.proceed();
  }

  pass(message) {
    this.newest = message.sequence;
    this.show(message);
  }

  proceed() {
    clearTimeout(this.timer);
    while (this.held.length > 0 && this.held[0].sequence <= (this.newest ?? this.held[0].sequence) + 1n) {
      this.pass(this.held.shift());
    }
    if (this.held.length > 0) this.request(5);
  }

  /** Ask as long as any frames come; after five times in vain, they exist no more. */
  request(triesLeft) {
    if (triesLeft === 0) {
      this.pass(this.held.shift());
      this.proceed();
      return;
    }
    const before = this.newest;
    this.ask(this.newest + 1n, this.held[0].sequence - 1n);
    this.timer = setTimeout(() => this.request(this.newest > before ? 5 : triesLeft - 1), 200);
  }
}

let numRequests = 0;

/** Return LCM's packet with a command_request_t for frames of the history. */
function historyRequest(source, first, last) {
  const integer = (value, bytes) => Buffer.from(value.toString(16).padStart(2 * bytes, '0'), 'hex');
  const text = (value) => Buffer.concat([integer(Buffer.byteLength(value) + 1, 4), Buffer.from(`${value}\0`)]);
  numRequests += 1;
  return Buffer.concat([
    Buffer.from('LC02'),
    integer(numRequests, 4),
    Buffer.from(`MOCAP_${source}_COMMAND_REQUEST\0`),
    integer(0x4514334e0ab92347n, 8), // the fingerprint of command_request_t
    integer(numRequests, 8),
    text(`subscriber.js ${process.pid} ${performance.timeOrigin}`), // the requester
    text('history'),
    integer(3, 4), // options
    ...['key=3d', `from=${first}`, `to=${last}`].map(text),
  ]);
}

function subscribe(source, count) {
  const url = process.env.LCM_DEFAULT_URL || 'udpm://239.255.76.67:7667';
  const [, group, port] = /^udpm:\/\/([\d.]+):(\d+)/.exec(url) ?? [];
  if (!group || port > 65535) return cannotReceive(`${url} is not a URL such as udpm://239.255.76.67:7667?ttl=1`);

  const ttl = Number(/[?&]ttl=(\d+)/.exec(url)?.[1] ?? 0);
  const queriesPort = Number(port) + 1; // requests, and what the gateway sends again, go to the next port
  const sockets = [];
  let received = 0;
  const close = () => {
    sockets.splice(0).forEach((socket) => socket.close());
    filler.held.length = 0;
    clearTimeout(filler.timer);
  };
  const filler = new GapFiller(
    (first, last) => sockets[1]?.send(historyRequest(source, first, last), queriesPort, group),
    (message) => {
      if (received === count) return;
      printMarkers(message);
      received += 1;
      if (received === count) close();
    },
  );

  const listen = (listenPort, wanted, onMarkers, onListening) => {
    const assembler = new Assembler();
    const socket = dgram.createSocket({ type: 'udp4', reuseAddr: true, recvBufferSize: 2_000_000 });
    sockets.push(socket);
    socket.on('message', (packet, sender) => {
      const [channel, data] = assembler.add(`${sender.address}:${sender.port}`, packet) ?? [];
      if (channel !== wanted || received === count) return;
      let message;
      try {
        message = decode('markers_t', data);
      } catch (error) {
        console.error(`ignored a malformed message on ${channel}: ${error.message}`);
        return;
      }
      onMarkers(message);
    });
    socket.on('error', (error) => cannotReceive(error.message));
    socket.bind(listenPort, () => {
      try {
        socket.addMembership(group);
        socket.setMulticastTTL(ttl);
      } catch (error) {
        cannotReceive(error.message);
        close();
        return;
      }
      onListening();
    });
  };
  listen(Number(port), `MOCAP_${source}_3D`, (message) => filler.add(message), () => {
    const again = (message) => filler.addAgain(message);
    listen(queriesPort, `MOCAP_${source}_3D_REFILL`, again, () => console.log('listening'));
  });
}

function printMarkers({ sequence, frame_number, timestamp, parameters_version, markers }) {
  const visible = markers.filter(({ x }) => !Number.isNaN(x));
  const time_s = (Number(timestamp) / 1e6).toFixed(4);
  let line = `#${sequence} frame ${frame_number} at ${time_s} s with parameters ${parameters_version}: `;
  line += `${visible.length} of ${markers.length} markers in view`;
  if (visible.length > 0) {
    const { x, y, z } = visible[0];
    line += `, the first at ${x.toFixed(3)}, ${y.toFixed(3)}, ${z.toFixed(3)} mm`;
  }
  console.log(line);
}

/** JSON of a decoded message: integers in full, and "nan", "inf" and "-inf" for what JSON has no number for. */
function toJson(value) {
  if (typeof value === 'bigint') return value.toString();
  if (typeof value === 'number' && !Number.isFinite(value)) {
    return Number.isNaN(value) ? '"nan"' : value > 0 ? '"inf"' : '"-inf"';
  }
  if (Array.isArray(value)) return `[${value.map(toJson).join()}]`;
  if (typeof value === 'object') {
    const fields = Object.entries(value).map(([name, field]) => `${JSON.stringify(name)}:${toJson(field)}`);
    return `{${fields.join()}}`;
  }
  return JSON.stringify(value);
}

/** Decode each line "TYPE HEX" of standard input, and print one line of JSON for it. */
async function printVectors() {
  for await (const line of readline.createInterface({ input: process.stdin })) {
    const [typeName, digits = ''] = line.trim().split(/\s+/);
    try {
      const message = Buffer.from(digits, 'hex'); // ends at the first character that is no digit
      if (2 * message.length !== digits.length) throw new Error('this is not hexadecimal');
      console.log(toJson(decode(typeName, message)));
    } catch (error) {
      console.log(toJson({ error: error.message }));
    }
  }
}

function cannotReceive(reason) {
  fail(`cannot receive from LCM; check $LCM_DEFAULT_URL and the multicast route: ${reason}`);
}

function fail(text) {
  console.error(text);
  process.exitCode = 1;
}

const [source = 'LAB', count = '0'] = process.argv.slice(2);
if (source === '--vectors') {
  printVectors();
} else if (source.startsWith('-')) {
  console.log(
    'Print the markers that a gateway publishes on LCM.\nusage: subscriber.js [SOURCE [COUNT]] | --vectors',
  );
  if (source !== '--help') process.exitCode = 2;
} else if (!/^\d+$/.test(count)) {
  fail(`${count} is not a number of frames`);
} else {
  subscribe(source, Number(count) || Infinity);
}
