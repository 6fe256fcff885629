function take = read_take(file, lines)
%READ_TAKE  Read a take of the gateway, which is an LCM event log, in MATLAB or Octave.
%
%   Install MATLAB R2016b or newer, or Octave 6 or newer (Debian: octave). No toolbox or package is needed: the function
%   reads the log and its messages by the tables of docs/reference/messages.md. In the folder examples:
%
%   octave-cli --eval "read_take('walk.lcmlog')"      print the first frames of each component
%   take = read_take('walk.lcmlog');                  return the take
%
%   TAKE has a field for each channel of a component, such as take.MOCAP_LAB_3D, with these fields:
%
%     time_s            seconds from the first capture in the take to this one; a row for each frame
%     x, y, z, ...      as in the message; a row for each frame, and a column for each marker, tool, channel or plate.
%                       NaN if it is missing.
%     labels            the names of the columns, from the server's newest parameters; empty if their number differs
%     timestamp, ...    the other fields of the message; a row for each frame
%
%   Events have a row each; event_timestamp is the time stamp of the event. take.MOCAP_LAB_PARAMETERS is the newest XML.
%
%   READ_TAKE('--vectors', FILE) decodes each line "TYPE HEX" of FILE, by default of the standard input, and prints a
%   line of JSON for it.

    if strcmp(file, '--vectors')
        if nargin < 2
            lines = '/dev/stdin';
        end
        print_vectors(lines);
        return
    end
    [bytes, events] = read_log(file);
    content = struct();
    for channel = unique(events.channel)'
        is_here = strcmp(events.channel, channel{1});
        [starts, lengths] = deal(events.starts(is_here), events.lengths(is_here));
        name = matlab.lang.makeValidName(channel{1});
        type = type_of(bytes, starts, lengths);
        if strcmp(type, 'parameters_t')
            content.(name) = xml_in(bytes, starts(end), lengths(end));
        elseif ~isempty(type)
            content.(name) = decode_all(type, bytes, starts, lengths, channel{1});
        end
    end
    content = add_times_and_labels(content);
    if nargout == 0
        print_take(content);
    else
        take = content;
    end
end

% The messages. BYTES are those of a file. A message begins behind START of them and has LEN; its fields are big-endian,
% without padding.

function type = type_of(bytes, starts, lengths)
%TYPE_OF  Return the type of a channel's messages by their fingerprint; empty if this program does not decode it.
    types = {'markers_t', 'tools_t', 'analog_t', 'forces_t', 'events_t', 'tool_pose_t', 'parameters_t'};
    fingerprints = read_values(bytes, starts(lengths >= 8), 'int64');
    for i = 1:numel(types)
        layout = describe(types{i});
        if any(fingerprints == layout.fingerprint)
            type = types{i};
            return
        end
    end
    type = '';
end

function layout = describe(type)
%DESCRIBE  Return the fields of a type.
%   FIELDS are those of an item: name, type, length. COUNT is the name of the field with the number of items; without
%   one, the message has the fields once.
    switch type
        case 'markers_t'
            layout = message_of('e95d5a478ce229e4', 'num_markers', 'markers', {'x', 'y', 'z', 'reliability'});
        case 'tools_t'
            names = {'q0', 'qx', 'qy', 'qz', 'x', 'y', 'z', 'error'};
            layout = message_of('f922a353b61657b3', 'num_tools', 'tools', names);
        case 'analog_t'
            layout = message_of('cd43a9dd46669bec', 'num_channels', 'voltages', {'voltages'});
        case 'forces_t'
            names = {'fx', 'fy', 'fz', 'mx', 'my', 'mz'};
            layout = message_of('dc94defbb591810c', 'num_plates', 'plates', names);
        case 'events_t'
            fields = {'id', 'int32', 1; 'timestamp', 'int64', 1
                      'param1', 'int32', 1; 'param2', 'int32', 1; 'param3', 'int32', 1};
            layout = message_of('06a109c2ae7bf07c', 'num_events', 'events', fields);
        case 'tool_pose_t'
            fields = {'visible', 'uint8', 1; 'position_m', 'single', 3
                      'orientation_xyzw', 'single', 4; 'error_m', 'single', 1};
            layout = message_of('bf985441ca59ae7a', '', '', fields);
        case 'parameters_t'
            layout = message_of('b887caaa43d8318b', '', '', {});
        otherwise
            error('no type %s', type);
    end
    layout.type = type;
end

function layout = message_of(fingerprint, count, items, fields)
%MESSAGE_OF  Return the layout of a message with these fields for each item; names alone are those of floats.
    if size(fields, 1) == 1
        fields = [fields', repmat({'single', 1}, numel(fields), 1)];
    end
    prefix = {'utime', 'int64', 1; 'capture_utime', 'int64', 1; 'sequence', 'int64', 1; 'session', 'int32', 1
              'parameters_version', 'int32', 1; 'frame_number', 'int32', 1; 'timestamp', 'int64', 1};
    if ~isempty(count)
        prefix(end + 1, :) = {count, 'int32', 1};
    end
    layout = struct('count', count, 'items', items, 'prefix', {prefix}, 'fields', {fields});
    layout.fingerprint = read_values(uint8(sscanf(fingerprint, '%2x')), 0, 'int64');
    layout.items_at = 8 + sum(bytes_of(prefix));
    layout.item_bytes = sum(bytes_of(fields));
end

function num_items = numbers_of_items(layout, bytes, starts, lengths)
%NUMBERS_OF_ITEMS  Return how many items each message has; -1 if it is malformed.
    num_items = -ones(size(starts));
    whole = lengths >= layout.items_at;
    whole(whole) = read_values(bytes, starts(whole), 'int64') == layout.fingerprint;
    num_items(whole) = 1;
    if ~isempty(layout.count)
        num_items(whole) = double(read_values(bytes, starts(whole) + layout.items_at - 4, 'int32'));
    end
    num_items(num_items * layout.item_bytes ~= lengths - layout.items_at) = -1;
end

function [head, items] = decode(layout, bytes, starts, num_items)
%DECODE  Decode messages with NUM_ITEMS items each.
%   Both results have a field for each field of the messages, with a row for each message, and ITEMS a column for each
%   item.
    head = read_structs(bytes, starts + 8, layout.prefix);
    items = read_structs(bytes, starts + layout.items_at + (0:num_items - 1) * layout.item_bytes, layout.fields);
end

function values = read_structs(bytes, starts, fields)
    values = struct();
    widths = bytes_of(fields);
    for i = 1:size(fields, 1)
        [name, type, len] = fields{i, :};
        if len > 1
            values.(name) = read_values(bytes, starts + (0:len - 1) * widths(i) / len, type);
        else
            values.(name) = read_values(bytes, starts, type);
        end
        starts = starts + widths(i);
    end
end

function values = read_values(bytes, starts, type)
%READ_VALUES  Read a value behind each of these numbers of bytes.
    width = bytes_of({'', type, 1});
    little_endian = zeros(width, numel(starts), 'uint8');
    for i = 1:width
        little_endian(width + 1 - i, :) = bytes(starts(:) + i);
    end
    values = reshape(typecast(little_endian(:), type), size(starts));
end

function num_bytes = bytes_of(fields)
    sizes = struct('uint8', 1, 'int32', 4, 'single', 4, 'int64', 8);
    num_bytes = zeros(size(fields, 1), 1);
    for i = 1:numel(num_bytes)
        num_bytes(i) = sizes.(fields{i, 2}) * fields{i, 3};
    end
end

function xml = xml_in(bytes, start, len)
%XML_IN  Return the string of a parameters_t: behind 40 bytes, its length, and the text, which ends with a NUL.
    xml = '';
    if len > 44
        text_bytes = double(read_values(bytes, start + 40, 'int32')) - 1;
        xml = native2unicode(bytes(start + 45:start + min(44 + text_bytes, len)), 'UTF-8');
    end
end

% The log.

function [bytes, events] = read_log(file)
%READ_LOG  Return the bytes of an LCM event log, and the place of each event. Skip damage, with a warning.
    id = fopen(file, 'r');
    if id < 0
        error('cannot read %s', file);
    end
    bytes = fread(id, [1, Inf], '*uint8');
    fclose(id);
    starts = strfind(char(bytes), char([237, 161, 218, 1]))' - 1; % the sync word EDA1DA01
    starts = starts(starts + 28 <= numel(bytes)); % behind 20 bytes, the lengths of the channel and of the message
    messages = starts + 28 + double(read_values(bytes, starts + 20, 'int32'));
    ends = messages + double(read_values(bytes, starts + 24, 'int32'));
    is_event = messages > starts + 28 & ends >= messages & ends <= numel(bytes);
    at = 0;
    skipped = 0;
    for i = 1:numel(starts)
        is_event(i) = is_event(i) && starts(i) >= at; % otherwise it is within a message, or damaged
        if is_event(i)
            skipped = skipped + starts(i) - at;
            at = ends(i);
        end
    end
    skipped = skipped + numel(bytes) - at;
    if skipped > 0
        warning('%s: skipped %d bytes that are damaged or incomplete', file, skipped);
    end
    channel = @(start, message) char(bytes(start + 29:message));
    events.channel = arrayfun(channel, starts(is_event), messages(is_event), 'UniformOutput', false);
    events.starts = messages(is_event);
    events.lengths = ends(is_event) - messages(is_event);
end

function frames = decode_all(type, bytes, starts, lengths, channel)
%DECODE_ALL  Decode all messages of a channel. Leave out those that are malformed, with a warning.
    layout = describe(type);
    num_items = numbers_of_items(layout, bytes, starts, lengths);
    if any(num_items < 0)
        warning('%s: ignored %d malformed messages', channel, sum(num_items < 0));
    end
    starts = starts(num_items >= 0);
    num_items = num_items(num_items >= 0);
    frames = struct('type', type);
    counts = unique([num_items; isempty(layout.count)]); % at least one, for the fields, even if there is no message
    for count = counts(end:-1:1)' % the messages with the same number of items at once, the most items first
        rows = num_items == count;
        [head, items] = decode(layout, bytes, starts(rows), count);
        if strcmp(type, 'events_t')
            items.event_timestamp = items.timestamp;
            items = rmfield(items, 'timestamp');
        end
        frames = put_rows(put_rows(frames, rows, head), rows, items);
    end
    if strcmp(type, 'events_t')
        frames = one_row_for_each_event(frames);
    end
end

function frames = put_rows(frames, rows, values)
%PUT_ROWS  Put values into these rows of the fields of FRAMES, which have the most columns in the first call.
    for name = fieldnames(values)'
        part = values.(name{1});
        if ~isfield(frames, name{1})
            frames.(name{1}) = repmat(cast(NaN, class(part)), numel(rows), size(part, 2));
        end
        frames.(name{1})(rows, 1:size(part, 2)) = part;
    end
end

function events = one_row_for_each_event(frames)
    events = frames;
    most = size(frames.id, 2);
    is_event = bsxfun(@le, (1:most)', double(frames.num_events'));
    for name = fieldnames(rmfield(frames, 'type'))'
        values = frames.(name{1});
        values = repmat(values, 1, most / max(size(values, 2), 1))';
        events.(name{1}) = reshape(values(is_event), [], 1);
    end
end

function content = add_times_and_labels(content)
    first = intmax('int64');
    names = fieldnames(content);
    for i = numel(names):-1:1
        if ~isstruct(content.(names{i}))
            names(i) = [];
            continue
        end
        first = min([first; content.(names{i}).capture_utime]);
    end
    for i = 1:numel(names)
        frames = content.(names{i});
        frames.time_s = double(frames.capture_utime - first) / 1e6;
        frames.labels = {};
        parameters = regexprep(names{i}, '_[^_]*$', '_PARAMETERS');
        if isfield(content, parameters)
            frames.labels = labels_in(content.(parameters), frames);
        end
        content.(names{i}) = frames;
    end
end

function labels = labels_in(xml, frames)
%LABELS_IN  Return the labels of a component's items; empty if there are not as many labels as items.
    labels = {};
    sections = struct('markers_t', {{'The_3D', 'Marker'}}, 'tools_t', {{'The_6D', 'Tool'}}, ...
                      'analog_t', {{'Analog', 'Channel'}}, 'forces_t', {{'Force', 'Plate'}});
    if ~isfield(sections, frames.type)
        return
    end
    [section, item] = deal(sections.(frames.type){:});
    section = regexp(xml, ['<' section '>.*</' section '>'], 'match', 'once');
    items = regexp(section, ['<' item '[\s>].*?</' item '>'], 'match');
    found = cell(size(items));
    for i = 1:numel(items)
        label = [regexp(items{i}, '<Label>([^<]*)</Label>', 'tokens', 'once'), {''}];
        found{i} = strtrim(without_entities(label{1}));
    end
    layout = describe(frames.type);
    if numel(found) == size(frames.(layout.fields{1, 1}), 2)
        labels = found;
    end
end

function text = without_entities(text)
    entities = {'&lt;', '<'; '&gt;', '>'; '&quot;', '"'; '&apos;', ''''; '&amp;', '&'};
    for i = 1:size(entities, 1)
        text = strrep(text, entities{i, :});
    end
end

function print_take(content)
    names = fieldnames(content);
    for i = 1:numel(names)
        frames = content.(names{i});
        if ~isstruct(frames)
            continue
        end
        layout = describe(frames.type);
        for row = 1:min(3, size(frames.utime, 1))
            fprintf('%s sequence %d at %.6f s, frame %d with parameters %d:%s\n', names{i}, frames.sequence(row), ...
                    double(frames.timestamp(row)) / 1e6, frames.frame_number(row), ...
                    frames.parameters_version(row), text_of(layout, frames, row));
        end
        fprintf('%s: %d rows in %.3f s\n', names{i}, size(frames.utime, 1), max(frames.time_s) - min(frames.time_s));
    end
end

function text = text_of(layout, frames, row)
    text = '';
    switch layout.type
        case {'markers_t', 'tools_t'}
            text = positions(frames.x(row, :), frames.y(row, :), frames.z(row, :));
        case 'forces_t'
            text = positions(frames.fx(row, :), frames.fy(row, :), frames.fz(row, :));
        case 'analog_t'
            text = sprintf(' %.3f', frames.voltages(row, 1:min(5, end)));
        case 'events_t'
            text = sprintf(' 0x%x at %d us: %d %d %d', typecast(frames.id(row), 'uint32'), ...
                           frames.event_timestamp(row), frames.param1(row), frames.param2(row), frames.param3(row));
        case 'tool_pose_t'
            text = sprintf(' %.3f', frames.position_m(row, :));
    end
    if ~isempty(layout.count)
        text = sprintf(' %d %s:%s', frames.(layout.count)(row), layout.items, text);
    end
end

function text = positions(x, y, z)
    text = '';
    for i = 1:min(5, numel(x))
        if isnan(x(i))
            text = [text, ' missing']; %#ok<AGROW>
        else
            text = [text, sprintf(' %.3f,%.3f,%.3f', x(i), y(i), z(i))]; %#ok<AGROW>
        end
    end
end

% --vectors

function print_vectors(file)
    id = fopen(file, 'r');
    line = fgetl(id);
    while ischar(line)
        try
            fprintf('%s\n', json_of_line(line));
        catch problem
            fprintf('{"error":"%s"}\n', regexprep(problem.message, '["\\]|\s', ' '));
        end
        line = fgetl(id);
    end
    fclose(id);
end

function text = json_of_line(line)
    words = regexp(strtrim(line), '\s+', 'split');
    layout = describe(words{1});
    digits = [words{2:end}, ''];
    if mod(numel(digits), 2) == 1 || any(~isstrprop(digits, 'xdigit'))
        error('this is not hexadecimal');
    end
    message = uint8(sscanf(digits, '%2x'));
    num_items = numbers_of_items(layout, message, 0, numel(message));
    if num_items < 0 || isempty(layout.fields)
        error('this is not a whole %s', layout.type);
    end
    [head, items] = decode(layout, message, 0, num_items);
    text = json_fields(head, layout.prefix, 1);
    switch layout.type
        case 'tool_pose_t'
            text = [text, ',', json_fields(items, layout.fields, 1)];
        case 'analog_t'
            text = sprintf('%s,"voltages":%s', text, json_array(items.voltages));
        otherwise
            objects = cell(1, num_items);
            for i = 1:num_items
                objects{i} = ['{', json_fields(items, layout.fields, i), '}'];
            end
            text = sprintf('%s,"%s":[%s]', text, layout.items, strjoin(objects, ','));
    end
    text = ['{', text, '}'];
end

function text = json_fields(values, fields, item)
    parts = cell(1, size(fields, 1));
    for i = 1:numel(parts)
        name = fields{i, 1};
        if fields{i, 3} > 1
            value = json_array(values.(name));
        elseif strcmp(fields{i, 2}, 'uint8')
            value = json_boolean(values.(name)(item) ~= 0);
        else
            value = json_number(values.(name)(item));
        end
        parts{i} = sprintf('"%s":%s', name, value);
    end
    text = strjoin(parts, ',');
end

function text = json_array(values)
    text = ['[', strjoin(arrayfun(@json_number, values, 'UniformOutput', false), ','), ']'];
end

function text = json_boolean(value)
    names = {'false', 'true'};
    text = names{value + 1};
end

function text = json_number(value)
    if isinteger(value)
        text = sprintf('%d', value);
    elseif isnan(value)
        text = '"nan"';
    elseif isinf(value)
        text = sprintf('"%sinf"', repmat('-', 1, value < 0));
    else
        text = sprintf('%.9g', value);
    end
end
