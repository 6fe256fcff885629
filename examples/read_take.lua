-- Print the markers in a take, with the message types of lcm-gen.
--
--   make -C examples lua && lua5.4 examples/read_take.lua [FILE [CHANNEL [COUNT]]]     for example: walk.lcmlog
--
-- Needs Lua 5.4 (Debian: lua5.4) and the Python package lcm, which has lcm-gen. A take is an LCM event log, so
-- the program also reads what lcm-logger writes. FILE is examples/walk.lcmlog by default, CHANNEL is MOCAP_LAB_3D, and
-- COUNT is how many frames to print (default 20). With --vectors, the program decodes messages from standard input
-- instead (lcm_types/vectors/README.md).
--
-- To receive live, use LCM's own Lua module. Debian's liblcm-lua is for Lua 5.2, whose numbers are doubles; for newer
-- versions, build it from the sources of LCM. Then leave out the section "The module lcm".

local folder = arg[0]:match("^(.*)/") or "."
package.path = folder .. "/build/lua/?.lua;" .. folder .. "/build/lua/?/init.lua;" .. package.path

-- The module lcm: what decoding with the types of lcm-gen needs from it, by string.unpack of Lua 5.3.

local Hash = {}
Hash.__index = Hash

function Hash.new(value)
  return setmetatable({value = math.tointeger(tonumber(value))}, Hash)
end

function Hash.__add(a, b)
  return Hash.new(a.value + b.value)
end

function Hash:rotate(bits)
  self.value = self.value << bits | self.value >> (64 - bits)
end

local LETTERS = {q = "i8", i = "i4", I = "I4", f = "f", d = "d", ["?"] = "B"}

-- Return the values of one of lcm-gen's formats, such as ">qi?" or ">3d".
local function unpack_values(format, data)
  local letters = format:gsub("(%d+)(%a)", function(count, letter) return letter:rep(count) end)
  local values = table.pack(string.unpack((letters:gsub("[%a?]", LETTERS)), data))
  local place = 0
  for letter in letters:gmatch("[%a?]") do
    place = place + 1
    if letter == "?" then values[place] = values[place] ~= 0 end
  end
  return table.unpack(values, 1, place)
end

-- Return the bytes of a fingerprint, whose format is ">X".
local function pack_fingerprint(_, hash)
  return string.pack(">i8", hash.value)
end

-- Return a text of a message without the NUL at its end.
local function prepare_string(text)
  local content = text:match("^([^\0]*)\0$")
  if not content or not utf8.len(content) then error("a text is not UTF-8 up to a NUL", 0) end
  return content
end

package.preload.lcm = function()
  return {_hash = Hash, _pack = {pack = pack_fingerprint, unpack = unpack_values, prepare_string = prepare_string}}
end

local rtc3d = require("rtc3d")

-- Decoding

-- What the types of lcm-gen read from: it reports the end of the message instead of reading less.
local Reader = {}
Reader.__index = Reader

function Reader:read(size)
  if size < 0 or size > #self.data - self.place + 1 then error("the message ends too early", 0) end
  self.place = self.place + size
  return self.data:sub(self.place - size, self.place - 1)
end

-- Return the message; raise an error if the bytes are not one.
local function decode(message_type, data)
  if data:sub(1, 8) ~= message_type._packed_fingerprint then error("the fingerprint is of another type", 0) end
  local reader = setmetatable({data = data, place = 9}, Reader)
  local message = message_type._decode_one(reader)
  if reader.place ~= #data + 1 then error("the message is too long", 0) end
  for name, value in pairs(message) do
    if name:find("^num_") and value < 0 then error(name .. " is negative", 0) end
  end
  return message
end

-- Printing a take

-- Iterate over the channel and the bytes of each message in an LCM event log.
local function messages_of(log)
  return function()
    local header = log:read(28)
    if not header or #header < 28 then return nil end
    local sync, _, _, channel_size, data_size = string.unpack(">I4i8i8i4i4", header)
    if sync ~= 0xEDA1DA01 or channel_size < 0 or channel_size > 1000 or data_size < 0 or data_size > 1 << 28 then
      error("the file is damaged or not a take", 0)
    end
    -- Of 0 bytes, read returns nil at the end of the file.
    local channel = log:read(channel_size)
    return channel, channel and (log:read(data_size) or "")
  end
end

local function print_markers(message)
  local visible, first = 0, nil
  for _, marker in ipairs(message.markers) do
    if marker.x == marker.x then -- a missing marker is NaN
      visible = visible + 1
      first = first or marker
    end
  end
  local line = string.format("#%d frame %d at %.4f s with parameters %d: %d of %d markers in view", message.sequence,
    message.frame_number, message.timestamp / 1e6, message.parameters_version, visible, message.num_markers)
  if first then line = line .. string.format(", the first at %.3f, %.3f, %.3f mm", first.x, first.y, first.z) end
  print(line)
end

local function print_take(file, wanted, count)
  local log <close>, problem = io.open(file, "rb")
  if not log then error(problem, 0) end
  for channel, data in messages_of(log) do
    if count == 0 then return end
    if channel == wanted then
      local is_whole, message = pcall(decode, rtc3d.markers_t, data)
      if is_whole then
        print_markers(message)
        count = count - 1
      else
        io.stderr:write("ignored a malformed message on ", channel, ": ", message, "\n")
      end
    end
  end
end

-- Printing messages as JSON, for --vectors

local function quoted(text)
  local escaped = text:gsub('[%c"\\]', function(letter)
    return letter:byte() < 32 and string.format("\\u%04x", letter:byte()) or letter:match('["\\]') and "\\" .. letter
  end)
  return '"' .. escaped .. '"'
end

local function to_json(value)
  if type(value) == "string" then return quoted(value) end
  if math.type(value) == "float" and value ~= value then return '"nan"' end
  if value == math.huge or value == -math.huge then return value > 0 and '"inf"' or '"-inf"' end
  if math.type(value) == "float" then return string.format("%.17g", value) end
  if type(value) ~= "table" then return tostring(value) end
  local parts = {}
  if not getmetatable(value) then -- an array: messages have the metatable of their type
    for i, item in ipairs(value) do parts[i] = to_json(item) end
    return "[" .. table.concat(parts, ", ") .. "]"
  end
  for name, field in pairs(value) do parts[#parts + 1] = quoted(name) .. ": " .. to_json(field) end
  return "{" .. table.concat(parts, ", ") .. "}"
end

local function print_vectors()
  for line in io.lines() do
    local name, digits = line:match("^(%S*)%s*(%S*)")
    local data = digits:gsub("%x%x", function(byte) return string.char(tonumber(byte, 16)) end)
    local found
    if #digits % 2 ~= 0 or digits:find("%X") then
      found = '{"error": "this is not hexadecimal"}'
    elseif rtc3d[name] then
      local is_whole, message = pcall(decode, rtc3d[name], data)
      found = is_whole and to_json(message) or '{"error": ' .. quoted(tostring(message)) .. "}"
    else
      found = '{"error": "unknown type"}'
    end
    print(found)
  end
end

if arg[1] == "--vectors" then
  print_vectors()
elseif arg[1] and arg[1]:sub(1, 1) == "-" then
  print("Print the markers in a take.\nArguments: [FILE [CHANNEL [COUNT]]], or --vectors < LINES")
  os.exit(arg[1] == "--help" and 0 or 2)
else
  local count = math.tointeger(tonumber(arg[3] or 20))
  local is_read, message = false, "COUNT must be a number"
  if count then
    is_read, message = pcall(print_take, arg[1] or folder .. "/walk.lcmlog", arg[2] or "MOCAP_LAB_3D", count)
  end
  if not is_read then
    io.stderr:write(message, "\n")
    os.exit(1)
  end
end
