-- An ArduPilot as far as a servofd script knows it: outputs, servo telemetry, texts, logs, parameters, arming.
-- It runs SCRIPT on the rows of the file INPUT and writes what is logged into the file OUTPUT; results are in the table
-- that it returns. Without OUTPUT nothing is packed: an autopilot makes no strings of what it logs. Rows: time [us, int32],
-- armed (int32), then for each output pulse [us] or command [deg] (float; 0 none), position [deg, float; NaN none],
-- time of the position [ms, int32].

local rows = assert(io.open(INPUT, "rb"))
local log = OUTPUT and assert(io.open(OUTPUT, "wb"))
local result = { texts = {}, refusals = {}, named = 0, logged = 0, instructions = 0, most_instructions = 0,
                 heap_kb = 0, most_heap_kb = 0, parameters = {} }
local row, now_us = nil, 0
local FLOAT = "<i4I2fffff"

-- A number of 32 bits.
local function rounded(f)
   return function(x)
      return (string.unpack("f", string.pack("f", f(x))))
   end
end
local math_32 = { exp = rounded(math.exp), cos = rounded(math.cos), sin = rounded(math.sin), abs = math.abs,
                  max = math.max, min = math.min, sqrt = rounded(math.sqrt), type = math.type }

local place = {}
for k = 1, #OUTPUTS do
   place[OUTPUTS[k]] = 3 * k
end

local function uint32(value)
   return { toint = function() return value end, tofloat = function() return value + 0.0 end }
end
local shared_us, shared_ms = { value = 0 }, { value = 0 }
function shared_us.toint(self) return self.value end
shared_ms.toint = shared_us.toint

local telemetry = { k = 0 }
function telemetry.measured_position(self)
   local deg = row[self.k + 1]
   if deg == deg then return deg end
end
function telemetry.current()
end
function telemetry.last_update_ms(self)
   shared_ms.value = row[self.k + 2]
   return shared_ms
end
function telemetry.command_position(self)
   return row[self.k]
end

local world = {
   micros = function()
      shared_us.value = now_us
      return shared_us
   end,
   millis = function()
      return uint32(now_us // 1000)
   end,
   gcs = {
      send_text = function(_, severity, text)
         assert(math.type(severity) == "integer" and #text <= 50, text)
         result.texts[#result.texts + 1] = { now_us, severity, text }
      end,
      send_named_float = function(_, name, value)
         assert(#name <= 10 and value)
         result.named = result.named + 1
      end,
   },
   SRV_Channels = {
      get_output_pwm_chan = function(_, channel)
         local k = place[channel + 1]
         return k and row[k] // 1 | 0
      end,
   },
   servo_telem = not OLD and {
      get_telem = function(_, channel)
         local k = place[channel + 1]
         if k and row[k + 2] >= 0 then
            telemetry.k = k
            return telemetry
         end
      end,
   } or nil,
   logger = {
      write = function(_, name, labels, format, units, multipliers, output, ...)
         assert(name == "SFD" and #labels <= 58 and #format == #units and #format == #multipliers)
         result.logged = result.logged + 1
         if log then
            log:write(string.pack(FLOAT, now_us, output, ...))
         end
      end,
   },
   param = {
      get = function(_, name) return PARAMETERS[name] end,
      add_table = function(_, key, prefix, count)
         assert(key > 0 and key <= 200 and #prefix < 16 and count < 64)
         assert(key > 139 and key ~= 193, "a script that comes with ArduPilot 4.7 may have this key")
         return true
      end,
      add_param = function(_, key, index, name, default)
         result.parameters["SFD_" .. name] = default
         return true
      end,
   },
   Parameter = function(name)
      return { get = function() return PARAMETERS[name] or result.parameters[name] end }
   end,
   arming = {
      get_aux_auth_id = function() return 0 end,
      set_aux_auth_failed = function(_, id, why)
         assert(id == 0 and #why <= 41)
         result.refusals[#result.refusals + 1] = why
      end,
      set_aux_auth_passed = function(_, id)
         assert(id == 0)
         result.refusals[#result.refusals + 1] = ""
      end,
      is_armed = function() return row[2] ~= 0 end,
   },
   math = math_32, string = string, type = type, tostring = tostring, pcall = pcall, ipairs = ipairs, pairs = pairs, tonumber = tonumber,
}

local format = "<i4i4" .. string.rep("ffi4", #OUTPUTS)
local size = string.packsize(format)

local function next_row()
   local bytes = rows:read(size)
   if not bytes then return false end
   row = { string.unpack(format, bytes) }
   now_us = row[1]
   return true
end

-- Instructions of the script itself: on an autopilot the calls above are no Lua.
local function count()
   if debug.getinfo(2, "S").source == "=servofd.lua" then
      result.instructions = result.instructions + 1
   end
end

local loaded = false
next_row()
collectgarbage()
local before_kb = collectgarbage("count")
local run, delay = assert(load(SCRIPT, "=servofd.lua", "t", world))()
collectgarbage()
result.heap_kb = collectgarbage("count") - before_kb
while run do
   if COUNTED then debug.sethook(count, "", 1) end
   result.instructions = 0
   local stop = false
   run, delay = run()
   if COUNTED then
      debug.sethook()
      result.all_instructions = (result.all_instructions or 0) + result.instructions
      result.calls = (result.calls or 0) + 1
      result.most_instructions = math.max(result.most_instructions, result.instructions)
   end
   if not next_row() then break end
end
collectgarbage()
result.most_heap_kb = collectgarbage("count") - before_kb
result.ended = not run
rows:close()
if log then
   log:close()
end
return result
